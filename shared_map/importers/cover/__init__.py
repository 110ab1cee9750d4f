"""Land cover: codes and what they mean."""
