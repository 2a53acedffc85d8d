"""Points on an object in real video: chosen, followed, drawn, and judged as a demonstration."""
