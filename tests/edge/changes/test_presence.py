# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from numpy.typing import NDArray

from edge.changes.expect import Sighting
from edge.changes.presence import Presence
from edge.config.changes import PresenceConfig

CONFIG = PresenceConfig()


DISTANCE_M = 2.0


def place(degrees: float) -> NDArray[np.float64]:
    """Of a camera on a circle around the object."""
    angle = np.radians(degrees)
    return DISTANCE_M * np.array([np.sin(angle), 0.0, -np.cos(angle)])


def add(presence: Presence, sighting: Sighting, degrees: float, hit_rate: float = 0.9) -> None:
    presence.add(sighting, place(degrees), DISTANCE_M, hit_rate)


def test_one_viewpoint_never_tells_that_something_is_gone() -> None:
    presence = Presence(CONFIG)

    for i in range(1000):
        add(presence, "missed", 0.001 * i)

    assert not presence.is_gone
    assert presence.n_against == 1


def test_an_object_that_is_missed_all_around_is_gone() -> None:
    presence = Presence(CONFIG)

    for degrees in (0, 10, 20):
        assert not presence.is_gone
        for _ in range(3):
            add(presence, "missed", degrees)

    assert presence.is_gone
    assert presence.n_against == 3


@pytest.mark.parametrize("hit_rate", [0.3, 0.5, 0.77, 0.95])
def test_a_blinking_detector_does_not_take_an_object_away(hit_rate: float) -> None:
    # The model finds it as often as it did when the map was made, each image by itself.
    rng = np.random.default_rng(11)
    gone = 0
    for _ in range(200):
        presence = Presence(CONFIG)
        for degrees in np.repeat(np.arange(0, 80, 10), 5):
            sighting: Sighting = "seen" if rng.random() < hit_rate else "missed"
            add(presence, sighting, float(degrees), hit_rate)
        gone += presence.is_gone

    assert gone == 0


def test_what_the_model_hardly_ever_found_is_hard_to_miss() -> None:
    rare, usual = Presence(CONFIG), Presence(CONFIG)

    add(rare, "missed", 0.0, 0.2)
    add(usual, "missed", 0.0, 0.9)

    assert rare.log_odds > usual.log_odds


def test_a_gone_object_that_is_seen_again_is_there() -> None:
    presence = Presence(CONFIG)
    for degrees in (0, 10, 20, 30):
        for _ in range(3):
            add(presence, "missed", degrees)
    assert presence.is_gone

    for degrees in (0, 10, 20):
        for _ in range(3):
            add(presence, "seen", degrees)

    assert not presence.is_gone


def test_unclear_views_say_nothing() -> None:
    presence = Presence(CONFIG)
    before = presence.log_odds

    add(presence, "unclear", 40.0)

    assert presence.log_odds == before


def test_what_is_rarely_found_is_never_missed() -> None:
    rare = Presence(PresenceConfig())
    for i in range(40):
        rare.add("missed", np.array([0.3 * i, 0.0, 0.0]), 2.0, 0.2)
    assert not rare.is_gone


def test_many_images_from_a_place_say_no_more_than_two() -> None:
    two, many = Presence(PresenceConfig()), Presence(PresenceConfig())
    for presence, images in ((two, 2), (many, 50)):
        for _ in range(images):
            presence.add("missed", np.zeros(3), 2.0, 0.5)
    assert many.log_odds == two.log_odds
