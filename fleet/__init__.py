"""The simulated world: physical laws, domain types, engine, environment, bus and live participants."""
