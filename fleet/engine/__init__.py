"""The one engine: state, step, claims, limit crossings, observation and reset of simulated shifts."""
