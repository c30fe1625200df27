"""Names of the package, for type checkers, editors and `__init__.py`."""

from .api import FitResult as FitResult, fit as fit
from .cards.card import Card as Card, card as card
from .data.csv_file import read_test as read_test
from .data.measurement import Measurement as Measurement
from .errors import InputError as InputError, SimulationError as SimulationError
from .fitting.problem import make_params as make_params
from .report.plan import Plan as Plan
from .report.prediction import Prediction as Prediction
from .solve.simulation import Response as Response, simulate as simulate
from .springs.chain import (
    Chain as Chain,
    DisplacementDrive as DisplacementDrive,
    Impact as Impact,
    StressDrive as StressDrive,
)
from .springs.laws import (
    BistableSpring as BistableSpring,
    Functions as Functions,
    Law as Law,
    LinearSpring as LinearSpring,
    MicroscaleSpring as MicroscaleSpring,
    Param as Param,
    register as register,
)
from .springs.published import published as published
from .study.batch import batch as batch
from .study.cycles import CycleFits as CycleFits, fit_cycles as fit_cycles
from .study.identified import load as load
from .study.joint import joint as joint
from .study.joint_result import JointResult as JointResult
from .study.plan import plan as plan
from .study.predict import predict as predict

__version__: str
