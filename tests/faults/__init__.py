"""Faults of recordings: those of the table in docs/SECURITY.md."""

from gvo.testing.faults import Black as Black
from gvo.testing.faults import Dropped as Dropped
from gvo.testing.faults import Fault as Fault
from gvo.testing.faults import PixelFault as PixelFault
from tests.faults.delivery import *  # noqa: F403 - the names of the table
from tests.faults.images import *  # noqa: F403
