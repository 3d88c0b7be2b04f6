"""From a viewing graph to poses: the chain of named stages, its filters, and the state they share."""
