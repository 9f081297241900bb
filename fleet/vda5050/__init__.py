"""VDA 5050: a fleet as one stationary vehicle, for plant masters that speak MQTT."""
