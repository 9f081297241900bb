"""What to try: scenarios, and the composition root that builds and runs them."""
