"""Finds single images on the map: features, retrieval, matching, absolute pose."""
