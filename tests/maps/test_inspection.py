# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.tiles.reader import open_map
from maps.content import load, write
from maps.inspection import table
from maps.picture import draw
from tests.maps.labels.made_up_labels import labels_for
from tests.maps.small_map import edited_manifest, write_small_map

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


@pytest.mark.slow
def test_the_picture_names_its_axes_its_unit_and_what_it_shows(tmp_path: Path) -> None:
    folder = write_small_map(tmp_path / "plain").folder
    draw(folder, tmp_path / "plain.svg")  # its comments are the words of the picture
    words = (tmp_path / "plain.svg").read_text()
    for said in ("x [m]", "z [m]", "-y [m]", "keyframes", "images that see a point"):
        assert f"<!-- {said} -->" in words, said
    with edited_manifest(folder) as manifest:
        manifest["metric"] = False
        manifest["T_local_map"] = np.eye(4).tolist()
    draw(folder, tmp_path / "plain.svg")
    words = (tmp_path / "plain.svg").read_text()
    assert "<!-- z, levelled [units of the map, not metres] -->" in words
