"""The bus: keys and messages, client and router, exchange between simulated arms, security."""
