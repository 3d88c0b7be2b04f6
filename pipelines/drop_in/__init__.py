"""What the scripts that take the place of other programs share."""
