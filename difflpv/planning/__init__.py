"""The cheapest model that a scene needs for an error, or the most accurate one for a time, and why."""
