"""The tile format and its reader."""
