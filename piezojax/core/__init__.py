"""The one protocol, the one loop over time, and what every other package shares."""
