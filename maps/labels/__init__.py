"""What a segmentation model says of the images of a map."""
