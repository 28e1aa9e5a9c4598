# The public names, each once: `__init__.py` loads them from here on first use, type checkers read this file as it is.

from .contradiction import Contradiction as Contradiction
from .contradiction import Verdict as Verdict
from .errors import InputError as InputError
from .estimation.consistency import verdict as verdict
from .estimation.factors.start import Prior as Prior
from .estimation.floors import floors_of as floors_of
from .estimation.graph import WalkGraph as WalkGraph
from .estimation.kalman import kalman_filter as kalman_filter
from .estimation.kalman import kalman_smoother as kalman_smoother
from .estimation.smoother import smooth as smooth
from .evaluation import evaluate as evaluate
from .floor.building import Building as Building
from .floor.plan import FloorPlan as FloorPlan
from .frames import Frame as Frame
from .frames import frame_of as frame_of
from .gait.compass import magnetic_headings as magnetic_headings
from .gait.steps import detect_steps as detect_steps
from .gait.walker import Walker as Walker
from .geometry import dead_reckon as dead_reckon
from .io import load as load
from .io.tables import read_fixes as read_fixes
from .io.tables import read_trajectory as read_trajectory
from .online.interface import Mode as Mode
from .online.interface import Pose as Pose
from .online.interface import Samples as Samples
from .online.interface import Scan as Scan
from .online.interface import events_of as events_of
from .online.journal import Journal as Journal
from .online.navigator import Navigator as Navigator
from .plotting import plot as plot
from .simulation.scenario import Scenario as Scenario
from .simulation.simulate import simulate as simulate
from .types import Calibration as Calibration
from .types import Estimate as Estimate
from .types import Fixes as Fixes
from .types import Headings as Headings
from .types import Recording as Recording
from .types import Sightings as Sightings
from .types import Signal as Signal
from .types import Steps as Steps
from .types import Trajectory as Trajectory

__version__: str
