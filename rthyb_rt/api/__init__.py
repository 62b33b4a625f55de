"""The public Python interface, ``import rthyb_rt as rt``; `rthyb_rt` lists its members."""
