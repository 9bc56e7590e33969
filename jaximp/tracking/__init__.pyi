from .paths import smoothed_path as smoothed_path
from .paths import smoothed_paths as smoothed_paths
from .paths import track as track
from .results import Curve as Curve
from .results import Drift as Drift
from .results import Path as Path
from .results import Track as Track
