"""COSMoS, the operator's side: reads scenarios, launches runs, collects and judges their evidence."""
