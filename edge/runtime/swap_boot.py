# SPDX-License-Identifier: Apache-2.0
"""Which map the daemon starts with: the current one, if it has not failed before."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from edge.errors import EdgeError, StoreError, TileError
from edge.store.records import Generation
from edge.store.store import Store

log = logging.getLogger(__name__)

T = TypeVar("T")


def open_first(store: Store, trial_starts: int, opener: Callable[[Path], T]) -> T | None:
    """Open the map to start with; None where the store has no map at all.

    A generation that was not found good yet is started with `trial_starts` times: if the process
    ended each time before it was, the last good one comes back. So it does where a map does not
    open; TileError where none does.
    """
    store.create()
    refusals = []
    for number in _candidates(store, trial_starts):
        try:
            generation = store.generation(number)
            opened = opener(store.map_folder(generation))
        except EdgeError as error:
            log.warning("event=map_does_not_open generation=%d %s", number, error)
            refusals.append(str(error))
            continue
        if store.linked("current") != number:
            log.warning("event=map_returned generation=%d", number)
            _activate(store, generation)
        return opened
    if refusals:
        raise TileError(f"{store.root}: none of its maps opens: {refusals[0]}")
    return None


def _activate(store: Store, generation: Generation) -> None:
    try:
        store.activate(generation)
    except StoreError as error:  # a full disk is no reason to have no map
        log.warning("event=map_not_activated %s", error)


def _count_start(store: Store, number: int) -> int:
    try:
        return store.note_trial(number)
    except StoreError as error:  # it did well enough to be put in use: better than no start
        log.warning("event=trial_not_noted %s", error)
        return 1


def _candidates(store: Store, trial_starts: int) -> Iterator[int]:
    current = store.linked("current")
    good = store.linked("good")
    tried = set()
    if current is not None and current != good:
        starts = _count_start(store, current)
        if starts > trial_starts and store.fallback_number(current) is not None:
            log.warning("event=map_never_good generation=%d starts=%d", current, starts - 1)
            tried.add(current)
    for number in (current, good, store.linked("previous")):
        if number is not None and number not in tried:
            tried.add(number)
            yield number
