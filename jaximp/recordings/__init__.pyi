from .errors import RecordingError as RecordingError
from .load import load_recording as load_recording
from .load import load_trial_table as load_trial_table
from .load import recording_from_arrays as recording_from_arrays
from .load import recording_from_mapping as recording_from_mapping
from .save import save_recording as save_recording
from .save import save_trial_table as save_trial_table
