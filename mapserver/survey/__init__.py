"""Survey: from a recording to a draft map. Pure: values in, values out."""
