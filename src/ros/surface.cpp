// The isosurface has a file of its own, because VTK's headers are heavy.

#include <vtkFloatArray.h>
#include <vtkFlyingEdges3D.h>
#include <vtkIdList.h>
#include <vtkImageData.h>
#include <vtkNew.h>
#include <vtkPointData.h>
#include <vtkPolyData.h>
#include <vtkPolyDataConnectivityFilter.h>
#include <vtkWindowedSincPolyDataFilter.h>

#include "svort_ros/ros/conversions.h"

namespace svort_ros {

visualization_msgs::Marker to_surface(const svort::Volume& volume, double threshold, const std_msgs::Header& header) {
  visualization_msgs::Marker marker;
  marker.header = header;
  marker.ns = "brain_surface";
  marker.type = visualization_msgs::Marker::TRIANGLE_LIST;
  marker.pose.orientation.w = 1.;
  marker.scale.x = marker.scale.y = marker.scale.z = 1.;
  marker.color.r = 1.F;
  marker.color.g = 0.84F;
  marker.color.b = 0.78F;
  marker.color.a = 0.4F;  // the current slice shows through

  const double level = threshold * reference_intensity(volume);
  if (level > 0.) {
    // In voxel units; ImageGrid::position() puts the vertices in their place.
    vtkNew<vtkImageData> image;
    image->SetDimensions(volume.grid.size.x(), volume.grid.size.y(), volume.grid.size.z());
    vtkNew<vtkFloatArray> values;
    values->SetArray(const_cast<float*>(volume.values.data()), static_cast<vtkIdType>(volume.values.size()), 1);
    image->GetPointData()->SetScalars(values);
    vtkNew<vtkFlyingEdges3D> contour;
    contour->SetInputData(image);
    contour->SetValue(0, level);
    contour->ComputeNormalsOff();
    contour->ComputeScalarsOff();
    // Specks outside the brain and the steps of voxels and mask edges are no anatomy.
    vtkNew<vtkPolyDataConnectivityFilter> largest;
    largest->SetInputConnection(contour->GetOutputPort());
    largest->SetExtractionModeToLargestRegion();
    vtkNew<vtkWindowedSincPolyDataFilter> smooth;
    smooth->SetInputConnection(largest->GetOutputPort());
    smooth->SetNumberOfIterations(20);
    smooth->SetPassBand(0.03);
    smooth->NormalizeCoordinatesOn();
    smooth->Update();

    vtkPolyData* surface = smooth->GetOutput();
    marker.points.reserve(3 * static_cast<std::size_t>(surface->GetNumberOfPolys()));
    vtkNew<vtkIdList> triangle;
    for (vtkIdType i = 0; i < surface->GetNumberOfCells(); ++i) {
      surface->GetCellPoints(i, triangle);
      for (vtkIdType corner = 0; corner < triangle->GetNumberOfIds(); ++corner) {
        Eigen::Vector3d index;
        surface->GetPoint(triangle->GetId(corner), index.data());
        const Eigen::Vector3d position_mm = volume.grid.position(index);
        geometry_msgs::Point point;
        point.x = position_mm.x() / 1000.;
        point.y = position_mm.y() / 1000.;
        point.z = position_mm.z() / 1000.;
        marker.points.push_back(point);
      }
    }
  }
  marker.action = marker.points.empty() ? visualization_msgs::Marker::DELETE : visualization_msgs::Marker::ADD;
  return marker;
}

}  // namespace svort_ros
