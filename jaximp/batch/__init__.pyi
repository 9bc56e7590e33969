from .overview import write_overview as write_overview
from .plan import Item as Item
from .plan import Plan as Plan
from .plan import find_items as find_items
from .plan import make_plan as make_plan
from .run import Outcome as Outcome
from .run import read_recordings as read_recordings
from .run import run_plan as run_plan
