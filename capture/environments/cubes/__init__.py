"""The suite `cubes`: coloured cubes on a table, where the instruction alone decides what is right."""
