"""The public interface in Python: what ``import rthyb_rt as rt`` gives, listed in `rthyb_rt`."""
