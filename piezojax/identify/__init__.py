"""From a lab's record to a plant model."""

from .models import MODELS as MODELS
from .output_error import Fit as Fit
from .output_error import FitReport as FitReport
from .output_error import free_run as free_run
from .output_error import identify as identify
from .record import Record as Record
from .record import read_record as read_record
