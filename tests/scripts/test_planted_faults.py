"""Every planted fault still has its place: `make faults` plants none while one lacks it."""

from __future__ import annotations

from scripts.planted_faults import FAULTS, inapplicable


def test_every_fault_applies_and_has_a_name_of_its_own():
    assert inapplicable(FAULTS) == []
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
