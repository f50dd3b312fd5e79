#pragma once

#include <vector>

#include "csv_rows.h"
#include "svort_ros/evaluation/accuracy.h"

namespace svort {

/// The columns of accuracy.csv.
const std::vector<CsvColumn<AccuracyRow>>& accuracy_columns();

}  // namespace svort
