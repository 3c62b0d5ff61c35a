"""Offline map compiler: posed images in, tiles out."""
