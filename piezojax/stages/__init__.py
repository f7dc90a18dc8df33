"""Stages with a controller: emulated, remote, or an NV200; trial and watch of gains."""

from .changes import Baseline as Baseline
from .changes import Judgement as Judgement
from .changes import RunFeatures as RunFeatures
from .changes import WatchReport as WatchReport
from .changes import watch as watch
from .connect import stage_of as stage_of
from .emulated import EmulatedStage as EmulatedStage
from .emulated import Limits as Limits
from .faults import Fault as Fault
from .nv200_stage import NV200Stage as NV200Stage
from .protocol import ConnectedStage as ConnectedStage
from .protocol import LostError as LostError
from .protocol import Stage as Stage
from .protocol import StageError as StageError
from .protocol import StoppedError as StoppedError
from .remote import RemoteStage as RemoteStage
from .server import StageServer as StageServer
from .try_gains import Motion as Motion
from .try_gains import TrialReport as TrialReport
from .try_gains import TriedRun as TriedRun
from .try_gains import trial as trial
