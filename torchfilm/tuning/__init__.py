"""How accurately a scene is simulated: settings, presets, and the search for the cheapest settings
that hold an error."""
