"""Readers for published view graphs and pose graphs."""
