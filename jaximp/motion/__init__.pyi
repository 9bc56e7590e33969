from .trajectories import FourierSeries as FourierSeries
from .trajectories import MinimumJerk as MinimumJerk
from .trajectories import RaisedSine as RaisedSine
from .trajectories import SixthOrder as SixthOrder
from .trajectories import at_rest as at_rest
from .trajectories import jerk as jerk
