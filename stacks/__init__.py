"""The platform on AWS as CDK code: one construct for each box of the paper's Fig. 2, in five stacks."""
