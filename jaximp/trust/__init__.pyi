from .verdicts import Confidence as Confidence
from .verdicts import MatrixCriteria as MatrixCriteria
from .verdicts import TrustLimits as TrustLimits
from .verdicts import Verdicts as Verdicts
from .verdicts import confidence as confidence
from .verdicts import fake_change_threshold as fake_change_threshold
from .verdicts import matrix_criteria as matrix_criteria
