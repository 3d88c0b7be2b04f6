"""Models in the file formats of other programs, one module per family of formats."""
