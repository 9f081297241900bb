"""The bus contract: keys, messages, and the schemas made from them."""
