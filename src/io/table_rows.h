#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include "csv_rows.h"
#include "svort_ros/io/brain_volume_file.h"
#include "svort_ros/io/evaluation_table.h"

namespace svort {

// For the sources that make tables of methods.

const std::vector<CsvColumn<TableScore>>& score_columns();
const std::vector<CsvColumn<TableSlice>>& slice_columns();
const std::vector<CsvColumn<TablePrefix>>& prefix_columns();

/// Whether a score is one of this row of this plan, of that many stacks.
inline bool belongs(const TableKey& key, const TablePlan& plan, const TableRow& row, int stacks) {
  const TableKey own = table_key(row.method, "", {});
  const auto tested = [&](const std::string& volume) { return volume_name(volume) == key.brain; };
  return key.method == own.method && key.weights == own.weights && key.iterations == own.iterations &&
         key.protocol == plan.protocol && key.stacks == stacks &&
         std::find(plan.motions.begin(), plan.motions.end(), key.motion) != plan.motions.end() &&
         std::find(plan.seeds.begin(), plan.seeds.end(), key.seed) != plan.seeds.end() &&
         std::any_of(plan.volumes.begin(), plan.volumes.end(), tested);
}

}  // namespace svort
