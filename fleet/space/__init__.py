"""Space that arms take: links as capsules, swept by plans, and which plans of two arms exclude each other."""
