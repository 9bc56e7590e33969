from .estimates import write_results as write_results
from .impedance import write_trials_results as write_trials_results
from .posterior import write_arm_posterior as write_arm_posterior
from .posterior import write_posterior_results as write_posterior_results
