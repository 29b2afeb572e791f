"""Known answers, one file per problem: numpy, scipy and mpmath only, nothing of the package under test.

Units are SI. Every file states its source, signs and axes at its top and carries its standard run as `RUN`.
Motions are functions of an array of times and return a dictionary of float64 arrays by name.
"""
