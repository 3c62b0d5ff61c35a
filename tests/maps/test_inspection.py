# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.tiles.reader import open_map
from maps.content import load, write
from maps.inspection import draw, table
from tests.maps.labels.made_up_labels import labels_for
from tests.maps.small_map import write_small_map

FIRST_BGR = (180, 119, 31)  # matplotlib's first colour: the class of most points


@pytest.mark.slow
def test_labels_are_counted_and_drawn_in_colours_of_their_own(tmp_path: Path) -> None:
    plain = write_small_map(tmp_path / "plain").folder
    content = load(open_map(plain))
    labelled = content._replace(extra={"labels": labels_for(content)})
    write(labelled, open_map(plain).manifest, tmp_path / "labelled")
    assert f"{len(content.views) - 1} objects" in table(tmp_path / "labelled")
    assert "objects" not in table(plain)
    shown = []
    for folder in (plain, tmp_path / "labelled"):
        picture = folder.with_suffix(".png")
        draw(folder, picture)
        pixels = cv2.imread(str(picture)).astype(int)
        shown.append(np.count_nonzero(np.abs(pixels - FIRST_BGR).max(axis=2) < 12))
    assert shown[1] > shown[0] + 5
