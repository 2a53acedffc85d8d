"""From tracks in a film to an arm that repeats them in the scene."""
