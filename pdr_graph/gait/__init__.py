"""Gait: from attitude and samples to landings, steps and walking directions."""
