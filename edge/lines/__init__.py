"""Straight lines in images and in space: found, measured, and used to tell a pose."""
