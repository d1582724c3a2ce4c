"""The experiments of the paper: each makes records, and draws its figures from them."""
