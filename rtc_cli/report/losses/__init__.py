"""Where success is lost under delay: costs, classes, recovered fractions, their figures."""
