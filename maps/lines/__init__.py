"""Lines in space, found in the images of a map."""
