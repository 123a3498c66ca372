"""The accuracy of a simulation: settings, presets, and the search for the cheapest settings that
keep the error within a limit."""
