"""The tree of frames: planted holes are found."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gvo.diagnostics.check.findings import Finding
from gvo.diagnostics.check.frame_tree import check_frame_tree
from gvo.io.poses.tf import TfBuffer
from tests.diagnostics.check.planted import check, complaints, render
from tests.make.bags import add_transform

S = 1_000_000_000
STAMPS_NS = np.arange(0, 10 * S, S // 10, dtype=np.int64)


def tree(*, leave_out: str = "", moving_ns: Any = STAMPS_NS) -> TfBuffer:
    buffer = TfBuffer()
    for stamp_ns in moving_ns:
        add_transform(buffer, "odom", "base_link", int(stamp_ns), np.eye(4))
    for parent, child in (
        ("base_link", "camera_link"),
        ("camera_link", "camera_optical"),
        ("camera_optical", "eye"),
    ):
        if child != leave_out:
            add_transform(buffer, parent, child, 0, np.eye(4), is_static=True)
    return buffer


def look(
    buffer: TfBuffer, camera: str = "camera_optical", base: str = "base_link"
) -> dict[str, Finding]:
    found = check_frame_tree(buffer, camera, STAMPS_NS, base_frame=base)
    return {finding.name: finding for finding in found}


@pytest.mark.parametrize("slash", ["", "/"])
def test_a_whole_tree_is_fine(slash: str) -> None:
    findings = look(tree(), f"{slash}camera_optical", f"{slash}base_link")
    assert complaints(findings) == set()
    assert findings["tf: camera"].value == "base_link - camera_link - camera_optical"
    assert findings["tf: frames"].value == "5 in 1 tree (root odom)"


def test_a_camera_without_transforms_or_without_a_base_is_found() -> None:
    findings = look(tree(), "zed_left")
    assert complaints(findings) == {"tf: camera"}
    assert "zed_left" in findings["tf: camera"].fix
    findings = look(tree(leave_out="camera_link"))
    assert complaints(findings) == {"tf: frames", "tf: camera"}
    assert findings["tf: camera"].value == "camera_optical is not connected to base_link"


def test_a_frame_with_two_parents_is_named_with_both() -> None:
    buffer = tree()
    for parent in ("tower", "odom"):
        add_transform(buffer, parent, "camera_link", 0, np.eye(4), is_static=True)
        findings = look(buffer)
        assert "camera_link has the parents base_link and" in findings["tf: frames"].fix
        assert ("tf: camera" in complaints(findings)) == (parent == "tower")
    assert "missing" not in findings["tf: frames"].fix


def test_gaps_and_an_early_end_of_the_transforms_are_found() -> None:
    sparse = STAMPS_NS[(STAMPS_NS < 4 * S) | (STAMPS_NS > 6 * S)]
    for stamps_ns, fault, value in ((sparse, "gaps", 2.2), (STAMPS_NS[:50], "images outside", 50)):
        findings = look(tree(moving_ns=stamps_ns))
        assert complaints(findings) == {f"tf: odom to camera_optical: {fault}"}
        assert findings[f"tf: odom to camera_optical: {fault}"].value == pytest.approx(value)


def test_a_recording_without_transforms_or_names_is_no_fault() -> None:
    assert complaints(look(TfBuffer())) == set()
    assert look(tree(), "")["tf: camera"].verdict == "unknown"


def test_the_tree_is_part_of_a_check() -> None:
    recording = render("handheld", "rgbd")
    names = {finding.name for finding in check(recording, transforms=tree()).findings}
    assert {"tf: frames", "tf: camera"} <= names
    assert not any(f.name.startswith("tf") for f in check(recording).findings)
