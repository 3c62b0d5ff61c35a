# SPDX-License-Identifier: Apache-2.0
import numpy as np

from edge.types import Detections, Mask
from maps.labels.votes import LabelVotes

POINTS = np.arange(4, dtype=np.int32)
PIXELS = np.array([[5, 5], [15, 5], [25, 5], [35, 5]], np.float32)


def columns(*labels: int) -> Detections:
    """Masks 10 px wide side by side, of these classes; -1 for none."""
    masks = tuple(
        Mask(10 * i, 0, np.ones((10, 10), dtype=bool)) for i, c in enumerate(labels) if c >= 0
    )
    classes = np.array([c for c in labels if c >= 0], np.int32)
    n = len(masks)
    return Detections(np.zeros((n, 4), np.float32), np.ones(n, np.float32), classes, masks)


def test_a_point_has_the_class_that_most_images_give_if_three_agree() -> None:
    votes = LabelVotes(5, 3)
    votes.add(POINTS, PIXELS, columns(0, 1, 2, -1))
    votes.add(POINTS, PIXELS, columns(0, 1, 2, 2))
    votes.add(POINTS, PIXELS, columns(0, 1, -1, 2))
    votes.add(POINTS, PIXELS, columns(0, 2, -1, 1))

    found = votes.count()

    assert found.label.tolist() == [0, 1, -1, -1, -1]
    assert found.agreeing.tolist() == [4, 3, 0, 0, 0]
    assert found.seen.tolist() == [4, 4, 4, 4, 0]
    assert found.log_odds[0] > found.log_odds[1] > 0.0
    assert (found.log_odds[2:] == 0.0).all()


def test_points_that_many_images_see_without_a_mask_are_doubted() -> None:
    votes = LabelVotes(1, 1)
    for i in range(20):
        votes.add(POINTS[:1], PIXELS[:1], columns(0 if i < 3 else -1))

    found = votes.count()

    assert found.label[0] == 0
    assert found.log_odds[0] < 0.0


def test_the_order_of_images_does_not_matter() -> None:
    rng = np.random.default_rng(5)
    images = [columns(*(int(c) for c in rng.integers(-1, 3, 4))) for _ in range(9)]
    one, other = LabelVotes(4, 3), LabelVotes(4, 3)
    for image in images:
        one.add(POINTS, PIXELS, image)
    for image in reversed(images):
        other.add(POINTS, PIXELS, image)

    for a, b in zip(one.count(), other.count(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_ties_go_to_the_lower_class() -> None:
    votes = LabelVotes(1, 3)
    for label in (2, 1, 2, 1, 1, 2):
        votes.add(POINTS[:1], PIXELS[:1], columns(label))

    assert votes.count().label.tolist() == [1]


def test_without_images_nothing_is_labelled() -> None:
    assert LabelVotes(3, 2).count().label.tolist() == [-1, -1, -1]
