"""The tables of coreset trees and of heads, the linear models that the trainer fits to the trees.

Compressor, trainer, checkpoint, codec, `catstream watch` and the page use these tables: a new tree or head is a new
row.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Training rows of windows at and around the object: label 1 for the object, 0 for background, between for near misses.
APPEARANCE = "appearance"
#: Training rows of windows of several sizes and aspects at the object: label 1 for the right ones, lower for others.
EXTENT = "extent"
#: The heads that predict the errors of a window's size and aspect.
SIZE, ASPECT = "size", "aspect"


@dataclass(frozen=True, slots=True)
class Head:
    """A ridge regression of one label of the rows of a tree.

    penalty        L2 penalty of the regression
    adds_to_score  whether it adds to the weights of the score; otherwise it is in `Model.heads`
    has_bias       if true, it predicts the label, with the bias in `Model.biases`. If false and it does not add to the
                   score, it is fitted to the residual of the score
    """

    name: str
    penalty: float
    adds_to_score: bool = False
    has_bias: bool = False


@dataclass(frozen=True, slots=True)
class Tree:
    """A coreset tree of each object.

    group     group of its training rows
    label     if not None, only feature rows x with this label are inserted. If None, all rows of the group are inserted
              with their labels y, as [x, 1, y ...] * sqrt(weight). Then ||A [w; b; -1 at a label]||^2 is the squared
              error of the linear model (w, b) of this label, which its head minimises
    heads     the head of each label, in the order of their columns
    required  whether a sample requires a leaf of this tree, because the score does
    title     title on the page
    meaning   description on the page
    """

    name: str
    group: str
    label: float | None
    heads: tuple[Head, ...]
    required: bool
    title: str
    meaning: str

    @property
    def more_columns(self) -> int:
        """Number of columns in addition to a feature row."""
        return 1 + len(self.heads) if self.label is None else 0


#: Penalty of the least squares of the object's mean against the background's mean and covariance.
DISCRIMINANT_RIDGE = 1.0

#: All trees, by name. Object and background share a regression: least squares of the object's mean against the
#: background's mean and covariance. Only the one-class classifier uses the object's rows.
TREES = {
    tree.name: tree
    for tree in (
        Tree("object", APPEARANCE, 1.0, (), True, "Object", "what the object has looked like"),
        Tree("background", APPEARANCE, 0.0, (), True, "Background", "the background around the object"),
        Tree(
            "loss", APPEARANCE, None, (Head("loss", 0.1, adds_to_score=True),), True, "Object or background",
            "both, with the score that each should get: the score is learned from these",
        ),
        Tree(
            "extent", EXTENT, None,
            (Head(EXTENT, 0.1), Head(SIZE, 0.03, has_bias=True), Head(ASPECT, 0.03, has_bias=True)),
            False, "Size and shape",
            "boxes that fit the object, and boxes too large, small, wide or narrow: the box is learned from these",
        ),
    )
}  # fmt: skip

#: All heads, by name.
HEADS = {head.name: head for tree in TREES.values() for head in tree.heads}

#: The groups of training rows that a frame may have.
GROUPS = tuple(dict.fromkeys(tree.group for tree in TREES.values()))
