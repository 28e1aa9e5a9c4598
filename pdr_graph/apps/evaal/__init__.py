"""Competitions over the EvAAL API: the client, a trial, and its rows as they come."""
