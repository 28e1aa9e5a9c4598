"""Self-contained HTML reports of walks and days: results, their uncertainty, and the reasons."""
