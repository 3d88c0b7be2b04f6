"""Scenes with known truth, for research and tests; nothing that users run imports them."""
