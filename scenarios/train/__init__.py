"""Training of policies: networks on a scenario, and prices of `bid_price` on a split by evolution."""
