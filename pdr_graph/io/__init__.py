"""Readers of recordings and tables, and writers of trajectories. `loading` recognises a recorder by content."""
