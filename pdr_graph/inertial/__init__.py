"""The phone: samples to attitude."""
