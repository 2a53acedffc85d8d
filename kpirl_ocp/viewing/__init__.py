"""Results to look at: figures, an arm in the browser, videos and recordings of its plan."""
