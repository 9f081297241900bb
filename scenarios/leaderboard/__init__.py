"""The leaderboard: results of policies on a whole split, one file each, their check and their table."""
