"""The auctioneer: rounds, ledger, leases."""
