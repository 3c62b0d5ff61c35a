"""Wires the stages together: threads, replay, live."""
