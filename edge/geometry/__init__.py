"""Rotations, rigid and similarity transforms, camera models: pure mathematics."""
