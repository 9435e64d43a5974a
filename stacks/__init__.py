"""The paper's Fig. 2 on AWS: one construct for each box, five stacks that hold them."""
