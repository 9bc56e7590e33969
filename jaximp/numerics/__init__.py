"""Small linear algebra and the settings of the compiler, for all that follows."""
