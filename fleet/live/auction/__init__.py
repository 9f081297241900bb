"""The auctioneer: rounds, awards, leases."""
