"""Commands about heat."""
