"""From what users write, expressions and numbers, to stage functions and arrays; refusals in one sentence."""
