"""Operations on arrays of rotations, directions and similarities."""
