"""Looks for maps that break their reader."""
