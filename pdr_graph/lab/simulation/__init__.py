"""Walks with known truth, written as raw phone sensors."""
