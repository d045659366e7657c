"""All named faults."""

from __future__ import annotations

from typing import Any

import pytest

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

# One of each group.
_IN_SHORT_RUN = (
    "dropped-some", "stamp-ahead", "black", "transposed", "exchanged", "depth-nan", "baseline-in-mm"
)  # fmt: skip


def parameters(*values: Any, fault: NamedFault, id_: str = "") -> Any:
    """Return the parameters of a test that the short run takes for one fault of each group."""
    marks = () if fault.name in _IN_SHORT_RUN else (pytest.mark.acceptance,)
    return pytest.param(*values, id=id_ or fault.name, marks=marks)
