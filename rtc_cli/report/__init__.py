"""Tables, figures and pages made from the rows of a run; never imports JAX."""
