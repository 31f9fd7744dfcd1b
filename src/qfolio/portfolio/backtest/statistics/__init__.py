"""The statistics of track records: measures, their intervals and tests, and verdicts in sentences.

They know returns, turnover and weights as arrays, and nothing of how a backtest came to them.
"""
