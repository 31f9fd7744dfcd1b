def write_study_report(run):
    pass
