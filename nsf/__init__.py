"""Neural stress fields: reduced-order elastoplasticity and fracture."""
