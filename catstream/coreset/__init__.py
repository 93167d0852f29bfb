"""The coreset trees of all objects: reduction, nodes, trees, samples, the forest and its checkpoints."""
