"""What arms of a simulated shift share with each other: in memory or over Zenoh."""
