"""Allocation without an auctioneer: claims granted by a majority of the arms."""
