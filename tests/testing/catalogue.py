"""All named faults."""

from __future__ import annotations

from tests.testing.catalogue_of_cameras import CALIBRATION, DEPTH, STEREO
from tests.testing.catalogue_of_delivery import DELIVERY
from tests.testing.catalogue_of_images import LIGHT_AND_LENS, TRANSFER
from tests.testing.catalogue_of_stamps import STAMPS
from tests.testing.named import NamedFault

FAULTS: dict[str, NamedFault] = {
    fault.name: fault
    for group in (DELIVERY, STAMPS, LIGHT_AND_LENS, TRANSFER, STEREO, DEPTH, CALIBRATION)
    for fault in group
}
"""By name, in the order of the table in docs/reliability.md."""
