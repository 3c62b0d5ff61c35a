# SPDX-License-Identifier: Apache-2.0
"""Fixes that wait for others to agree with."""

from collections import deque
from collections.abc import Sequence

from edge.config.registration import RegistrationConfig
from edge.registration.agreement import Agreed, agree, agreeing, independent, standing
from edge.registration.motion import OdometryTrack
from edge.types import Fix

_NEWEST = 12  # enough to span a rest, however often fixes come


class Candidates:
    """The last fixes that nothing has confirmed yet, spread over the way."""

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._fixes: deque[Fix] = deque(maxlen=max(config.first_of_last, config.overrule_of_last))
        self._newest: deque[Fix] = deque(maxlen=_NEWEST)  # from one place or not

    def __len__(self) -> int:
        return len(self._fixes)

    def clear(self) -> None:
        """Forget all."""
        self._fixes.clear()
        self._newest.clear()

    def forget_before(self, track: OdometryTrack) -> None:
        """Forget those of frames that `track` no longer knows."""
        while self._fixes and not track.holds(self._fixes[0].index):
            self._fixes.popleft()
        while self._newest and not track.holds(self._newest[0].index):
            self._newest.popleft()

    def is_late(self, fix: Fix, track: OdometryTrack) -> bool:
        """Whether `fix` comes before one that is held."""
        return bool(self._fixes) and not track.is_later(fix.index, self._fixes[-1].index)

    def add(self, fix: Fix) -> None:
        """Take in a fix; of several from one place one is enough."""
        self._newest.append(fix)
        if len(self._fixes) > 1 and not self.moved():
            # Kept is one that tells the scale, else the older.
            told = self._fixes[-1].log_scale is not None
            del self._fixes[-2 if told and self._fixes[-2].log_scale is None else -1]
        self._fixes.append(fix)

    def speak_against(self, index: int | None, group: Sequence[Fix], track: OdometryTrack) -> bool:
        """Whether others make the fix of frame `index`, that the odometry began with, a wrong one.

        `group` agree with one another, and may have done so without asking that one. Where none
        do, another vote is enough.
        """
        asked = next((fix for fix in self._fixes if fix.index == index), None)
        if asked is None:
            return False
        if group:
            others = [fix for fix in group if fix.index != index]
            return not agree((asked, *others), track, self._config)
        return len(self._fixes) > 1 and self.moved()

    def disagree(self, *, overruling: bool) -> bool:
        """Whether more than need to agree are held, and the newest is a vote of its own."""
        return len(self._fixes) > self._needed(overruling=overruling)[0] and self.moved()

    def moved(self) -> bool:
        """Whether the last two are two votes."""
        before, newest = list(self._fixes)[-2:]
        return independent(before, newest, self._config)

    def agreed(self, track: OdometryTrack, *, overruling: bool) -> Agreed | None:
        """Those that agree with the newest, if they are enough; more are needed to overrule."""
        needed, of_last = self._needed(overruling=overruling)
        agreed = agreeing(list(self._fixes)[-of_last:], track, needed, self._config)
        if agreed is None and not overruling:
            return standing(list(self._newest), track, self._config)
        return agreed

    def _needed(self, *, overruling: bool) -> tuple[int, int]:
        config = self._config
        if overruling:
            return config.overrule_agreeing, config.overrule_of_last
        return config.first_agreeing, config.first_of_last
