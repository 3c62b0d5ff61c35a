"""All settings, with units and reasons."""
