"""The digital thread: from an event to job, plan, offers, twin, training data, configuration and code."""
