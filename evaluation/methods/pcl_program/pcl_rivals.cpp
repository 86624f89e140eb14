// Segments one organized cloud with a method of the Point Cloud Library.
//
//   pcl_rivals lccp|organized WIDTH HEIGHT POINTS COLORS LABELS
//
// POINTS holds WIDTH*HEIGHT*3 float32 (meters, NaN where there is none), COLORS as many uint8 (RGB),
// LABELS receives WIDTH*HEIGHT uint16 (0 where there is no point).

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <map>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include <pcl/features/integral_image_normal.h>
#include <pcl/point_cloud.h>
#include <pcl/point_types.h>
#include <pcl/segmentation/euclidean_cluster_comparator.h>
#include <pcl/segmentation/lccp_segmentation.h>
#include <pcl/segmentation/organized_connected_component_segmentation.h>
#include <pcl/segmentation/organized_multi_plane_segmentation.h>
#include <pcl/segmentation/supervoxel_clustering.h>

namespace {

using Point = pcl::PointXYZRGBA;
using Cloud = pcl::PointCloud<Point>;
using Labels = std::vector<std::uint16_t>;

// Supervoxels: fine enough for objects of a few centimeters at 0.5 to 2 m.
constexpr float kVoxelM = 0.005F;
constexpr float kSeedM = 0.02F;
constexpr float kColorWeight = 0.0F;
constexpr float kSpatialWeight = 1.0F;
constexpr float kNormalWeight = 4.0F;
// Convexity: patches that meet under less than this count as convex. The best of twenty settings on the
// cluttered frames of docs/accuracy.md.
constexpr float kConcavityToleranceDeg = 20.0F;
constexpr unsigned kExtendedConvexity = 1;
constexpr float kSmoothness = 0.2F;
constexpr std::uint32_t kSmallestSegment = 6;

// Planes and clusters of the organized cloud.
constexpr unsigned kPlanePixels = 1000;
constexpr double kPlaneAngleRad = 3.0 * M_PI / 180.0;
constexpr double kPlaneDistanceM = 0.02;
constexpr float kClusterDistanceM = 0.01F;
constexpr std::size_t kClusterPixels = 200;

template <typename Value>
std::vector<Value> read_all(const char* path, std::size_t count) {
    std::vector<Value> values(count);
    std::ifstream stream(path, std::ios::binary);
    stream.read(reinterpret_cast<char*>(values.data()), static_cast<std::streamsize>(count * sizeof(Value)));
    if (!stream) throw std::runtime_error(std::string(path) + ": too short or unreadable");
    return values;
}

Cloud::Ptr read_cloud(unsigned width, unsigned height, const char* points_path, const char* colors_path) {
    const std::size_t size = static_cast<std::size_t>(width) * height;
    const auto points = read_all<float>(points_path, 3 * size);
    const auto colors = read_all<std::uint8_t>(colors_path, 3 * size);
    auto cloud = pcl::make_shared<Cloud>(width, height);
    cloud->is_dense = false;
    for (std::size_t i = 0; i < size; ++i) {
        Point& point = (*cloud)[i];
        point.x = points[3 * i];
        point.y = points[3 * i + 1];
        point.z = points[3 * i + 2];
        point.r = colors[3 * i];
        point.g = colors[3 * i + 1];
        point.b = colors[3 * i + 2];
        point.a = 255;
    }
    return cloud;
}

std::uint16_t compact(std::map<std::uint32_t, std::uint16_t>& seen, std::uint32_t label) {
    return seen.emplace(label, static_cast<std::uint16_t>(seen.size() + 1)).first->second;
}

Labels lccp(const Cloud::Ptr& cloud) {
    pcl::SupervoxelClustering<Point> supervoxels(kVoxelM, kSeedM);
    supervoxels.setUseSingleCameraTransform(true);
    supervoxels.setInputCloud(cloud);
    supervoxels.setColorImportance(kColorWeight);
    supervoxels.setSpatialImportance(kSpatialWeight);
    supervoxels.setNormalImportance(kNormalWeight);
    std::map<std::uint32_t, pcl::Supervoxel<Point>::Ptr> clusters;
    supervoxels.extract(clusters);
    std::multimap<std::uint32_t, std::uint32_t> adjacency;
    supervoxels.getSupervoxelAdjacency(adjacency);

    pcl::LCCPSegmentation<Point> patches;
    patches.setConcavityToleranceThreshold(kConcavityToleranceDeg);
    patches.setSmoothnessCheck(true, kVoxelM, kSeedM, kSmoothness);
    patches.setKFactor(kExtendedConvexity);
    patches.setInputSupervoxels(clusters, adjacency);
    patches.setMinSegmentSize(kSmallestSegment);
    patches.segment();
    auto labelled = supervoxels.getLabeledCloud();
    patches.relabelCloud(*labelled);

    Labels labels(cloud->size(), 0);
    std::map<std::uint32_t, std::uint16_t> seen;
    for (std::size_t i = 0; i < cloud->size(); ++i) {
        if (pcl::isFinite((*cloud)[i])) labels[i] = compact(seen, (*labelled)[i].label);
    }
    return labels;
}

Labels organized(const Cloud::Ptr& cloud) {
    pcl::IntegralImageNormalEstimation<Point, pcl::Normal> estimation;
    estimation.setNormalEstimationMethod(estimation.COVARIANCE_MATRIX);
    estimation.setMaxDepthChangeFactor(0.02F);
    estimation.setNormalSmoothingSize(10.0F);
    estimation.setInputCloud(cloud);
    auto normals = pcl::make_shared<pcl::PointCloud<pcl::Normal>>();
    estimation.compute(*normals);

    pcl::OrganizedMultiPlaneSegmentation<Point, pcl::Normal, pcl::Label> planes;
    planes.setMinInliers(kPlanePixels);
    planes.setAngularThreshold(kPlaneAngleRad);
    planes.setDistanceThreshold(kPlaneDistanceM);
    planes.setInputNormals(normals);
    planes.setInputCloud(cloud);
    std::vector<pcl::PlanarRegion<Point>, Eigen::aligned_allocator<pcl::PlanarRegion<Point>>> regions;
    std::vector<pcl::ModelCoefficients> models;
    std::vector<pcl::PointIndices> inliers;
    auto plane_labels = pcl::make_shared<pcl::PointCloud<pcl::Label>>();
    std::vector<pcl::PointIndices> label_indices;
    std::vector<pcl::PointIndices> boundaries;
    planes.segmentAndRefine(regions, models, inliers, plane_labels, label_indices, boundaries);

    auto excluded = pcl::make_shared<std::set<std::uint32_t>>();
    Labels labels(cloud->size(), 0);
    std::uint16_t next = 0;
    for (std::size_t plane = 0; plane < label_indices.size(); ++plane) {
        if (label_indices[plane].indices.size() <= kPlanePixels) continue;
        excluded->insert(static_cast<std::uint32_t>(plane));
        ++next;
        for (const auto i : label_indices[plane].indices) labels[i] = next;
    }

    auto comparator = pcl::make_shared<pcl::EuclideanClusterComparator<Point, pcl::Label>>();
    comparator->setInputCloud(cloud);
    comparator->setLabels(plane_labels);
    comparator->setExcludeLabels(excluded);
    comparator->setDistanceThreshold(kClusterDistanceM, false);
    pcl::PointCloud<pcl::Label> cluster_labels;
    std::vector<pcl::PointIndices> cluster_indices;
    pcl::OrganizedConnectedComponentSegmentation<Point, pcl::Label> clusters(comparator);
    clusters.setInputCloud(cloud);
    clusters.segment(cluster_labels, cluster_indices);
    // What is in no plane and no cluster of some size stays 0.
    for (const auto& cluster : cluster_indices) {
        if (cluster.indices.size() < kClusterPixels) continue;
        ++next;
        for (const auto i : cluster.indices) {
            if (labels[i] == 0 && pcl::isFinite((*cloud)[i])) labels[i] = next;
        }
    }
    return labels;
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 7) {
        std::cerr << "usage: pcl_rivals lccp|organized WIDTH HEIGHT POINTS COLORS LABELS\n";
        return 2;
    }
    try {
        const std::string method = argv[1];
        const auto width = static_cast<unsigned>(std::stoul(argv[2]));
        const auto height = static_cast<unsigned>(std::stoul(argv[3]));
        const auto cloud = read_cloud(width, height, argv[4], argv[5]);
        if (method != "lccp" && method != "organized") throw std::runtime_error(method + ": no such method");
        const Labels labels = method == "lccp" ? lccp(cloud) : organized(cloud);
        std::ofstream stream(argv[6], std::ios::binary);
        stream.write(reinterpret_cast<const char*>(labels.data()),
                     static_cast<std::streamsize>(labels.size() * sizeof(std::uint16_t)));
        if (!stream) throw std::runtime_error(std::string(argv[6]) + ": cannot be written");
    } catch (const std::exception& error) {
        std::cerr << "pcl_rivals: " << error.what() << '\n';
        return 1;
    }
    return 0;
}
