"""Tables and figures of the paper: graphs with known truth, methods measured on them, what is written."""
