"""From a lab's records to a plant model."""

from .fit import Fit as Fit
from .fit import FitReport as FitReport
from .fit import identify as identify
from .models import PARTS as PARTS
from .models import chain as chain
from .output_error import free_run as free_run
from .record import Record as Record
from .record import read_record as read_record
