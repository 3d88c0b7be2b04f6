"""A rendered scene with known cameras, from photographs to model."""
