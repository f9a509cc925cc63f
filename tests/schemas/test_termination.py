"""SIGTERM between episodes and during one."""

from __future__ import annotations

import signal

import pytest

from vla_attention.schemas.stop_signals import Terminated, Termination


def test_during_an_episode_a_signal_takes_effect_at_the_next_check() -> None:
    termination = Termination()
    steps = []

    def episode() -> None:
        with termination.only_at_checks():
            steps.append("begun")
            termination.on_signal(signal.SIGTERM, None)
            steps.append("after the signal")
            termination.check()
            steps.append("after the check")

    with pytest.raises(Terminated):
        episode()
    assert steps == ["begun", "after the signal"]


def test_between_episodes_a_signal_takes_effect_at_once() -> None:
    with pytest.raises(Terminated):
        Termination().on_signal(signal.SIGTERM, None)
