# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise
from pathlib import Path

import pytest

from edge.config.ladder import LadderConfig
from edge.config.loader import load_struct
from edge.errors import ConfigError
from edge.runtime.ladder import Ladder, Reading, Step

CONFIG = LadderConfig(down_after_s=3.0, up_after_s=30.0)
ALL = tuple(Step)
FINE = Reading(50.0, 0.2, 0.0)
HOT = Reading(85.0, 0.2, 0.0)
WARM = Reading(74.0, 0.2, 0.0)  # between cool and hot
SLOW = Reading(None, 0.95, 0.0)
DROPPING = Reading(None, 0.2, 0.2)
WEAK = Reading(50.0, 0.2, 0.0, under_voltage=True)


class Day:
    """A ladder that is asked once a second."""

    def __init__(self, config: LadderConfig = CONFIG, steps: tuple[Step, ...] = ALL) -> None:
        self.ladder = Ladder(config, steps)
        self.now_s = 0

    def go(self, reading: Reading, seconds: int) -> list[int]:
        """Level after each second."""
        levels = []
        for _ in range(seconds):
            self.now_s += 1
            self.ladder.step(self.now_s * 1_000_000_000, reading)
            levels.append(len(self.ladder.given_up))
        return levels


@pytest.mark.parametrize("trouble", [HOT, SLOW, DROPPING, WEAK])
def test_lasting_trouble_leads_down_step_by_step_to_the_last(trouble: Reading) -> None:
    day = Day()
    assert day.go(trouble, 3) == [0, 0, 0]
    levels = day.go(trouble, 40)
    assert levels[0] == 1
    assert max(b - a for a, b in pairwise(levels)) == 1
    assert day.ladder.given_up == ALL


def test_short_trouble_changes_nothing() -> None:
    day = Day()
    for _ in range(10):
        assert set(day.go(HOT, 2) + day.go(FINE, 1)) == {0}


def test_rest_leads_up_again_only_after_long_enough() -> None:
    day = Day()
    day.go(HOT, 4)
    assert set(day.go(FINE, 30)) == {1}
    assert day.go(FINE, 1) == [0]
    assert day.ladder.reasons == () or day.go(FINE, 1) == [0]
    assert day.ladder.reasons == ()


def test_between_hot_and_cool_it_stays_where_it_is() -> None:
    day = Day()
    day.go(HOT, 4)
    assert set(day.go(WARM, 300)) == {1}
    assert set(Day().go(WARM, 300)) == {0}


def test_reasons_name_what_is_wrong() -> None:
    day = Day()
    day.go(Reading(81.0, 0.9, 0.1), 4)
    assert [reason.split(":")[0] for reason in day.ladder.reasons] == ["hot", "slow", "slow"]
    day.go(WARM, 10)
    assert day.ladder.reasons  # as long as something is given up, it says why


def test_weak_supply_is_named() -> None:
    day = Day()
    day.go(WEAK, 4)
    assert day.ladder.reasons == ("under-voltage: the supply is too weak for the board",)


def wait_for_level_0(day: Day) -> int:
    seconds = 0
    while day.go(FINE, 1) != [0]:
        seconds += 1
    return seconds


def test_step_up_that_fails_makes_the_next_one_wait_longer() -> None:
    day = Day()
    waits = []
    for _ in range(8):
        day.go(HOT, 4)
        waits.append(wait_for_level_0(day))
    assert waits[:3] == [30, 60, 120]
    assert max(waits) == 600  # and no longer
    day.go(FINE, 1000)  # it lasted: what follows is another trouble
    day.go(HOT, 4)
    assert wait_for_level_0(day) == 30


def test_half_rate_is_left_only_where_the_whole_rate_has_room() -> None:
    day = Day(steps=(Step.HALF_RATE,))
    day.go(SLOW, 4)
    assert set(day.go(Reading(None, 0.4, 0.0), 100)) == {1}  # twice the frames: 0.8
    assert day.go(Reading(None, 0.2, 0.0), 100)[-1] == 0


def test_switched_off_it_never_moves() -> None:
    assert set(Day(LadderConfig(enabled=False)).go(HOT, 100)) == {0}


def test_bounds_that_contradict_are_refused(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("hot_c = 60.0\n")
    with pytest.raises(ConfigError, match="cool_c 70 must be below hot_c 60"):
        load_struct(tmp_path / "c.toml", LadderConfig)
