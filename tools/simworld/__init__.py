"""Simulated worlds with exact truth."""
