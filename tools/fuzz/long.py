# SPDX-License-Identifier: Apache-2.0
"""A pytest plugin for long searches: `pytest -p tools.fuzz.long tests/edge/tiles`."""

from hypothesis import settings

settings.register_profile("long", max_examples=5000)
settings.load_profile("long")
