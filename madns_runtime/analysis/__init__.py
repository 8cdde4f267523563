"""
Analysis of runs by their simulation: values of figures, recorded tables, and the sampling between the two.

A simulation's descriptor names a function `figures`, which takes a `RecordedRun` and returns sections of values
(`values`): series, bands, histograms, heat maps, bars, paths in space, tables and remarks, each with quantity and unit.
How they look is the renderer's business; nothing here knows a plotting library, a file format or a screen.

Records reach that function as columns of numpy arrays (`tables`), one source or one batch at a time, so that memory
follows what is drawn and not what was recorded. What is drawn is thinned so that no peak is lost (`sampling`);
what is told in numbers is made of every sample (`distribution`).
"""
