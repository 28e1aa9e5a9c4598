"""The walk under way: the batch's factors over a window, solved step by step."""
