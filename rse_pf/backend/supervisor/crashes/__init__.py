"""Workers that native code ends: what they leave behind, who takes their place, and who is shut out.

A worker that ends in another way belongs to `rse_pf.backend.supervisor`, which ends with it.
"""
