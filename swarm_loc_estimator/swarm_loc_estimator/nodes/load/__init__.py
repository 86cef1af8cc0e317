"""What a live estimator does when there is more to do than time: it fuses less often, then it uses less."""
