"""Where tracks go, during a run or from its log, and the report of them. `destinations` has the table of them."""
