"""From CasADi to C, from C to machine code, and from machine code to numpy."""
