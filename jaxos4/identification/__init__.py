"""From flights to an identification."""
