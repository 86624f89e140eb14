// What a camera sees: images that a test can compute too, or images from files.
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <string>
#include <vector>

#include "OniCTypes.h"

namespace virtualcam {

// Registered depth is the same pattern seen from a camera this many columns to the side.
constexpr int kRegistrationShift = 5;

inline uint16_t depth_at(long frame, int row, int col) {
    return static_cast<uint16_t>(500 + (row * 7L + col * 3L + frame * 11L) % 4000);
}

inline void color_at(long frame, int row, int col, uint8_t rgb[3]) {
    rgb[0] = static_cast<uint8_t>(row + frame);
    rgb[1] = static_cast<uint8_t>(col + 2 * frame);
    rgb[2] = static_cast<uint8_t>(row * 3L + col * 5L + frame * 7L);
}

// Raw images of one stream, depth_0000.raw or color_0000.raw and so on, played in a circle.
class RawImages {
public:
    void load(const std::string& folder, const std::string& stem) {
        images_.clear();
        for (int number = 0; !folder.empty(); ++number) {
            char name[32];
            std::snprintf(name, sizeof name, "/%s_%04d.raw", stem.c_str(), number);
            std::ifstream file(folder + name, std::ios::binary);
            if (!file) break;
            images_.emplace_back(std::istreambuf_iterator<char>(file), std::istreambuf_iterator<char>());
        }
    }

    // The image of a frame, or null where there is none of this size.
    const uint8_t* at(long frame, size_t bytes) const {
        if (images_.empty()) return nullptr;
        const auto& image = images_[static_cast<size_t>(frame) % images_.size()];
        return image.size() == bytes ? reinterpret_cast<const uint8_t*>(image.data()) : nullptr;
    }

private:
    std::vector<std::vector<char>> images_;
};

struct View {
    OniVideoMode mode;
    OniCropping crop;
    bool mirrored;
    bool registered;
    long frame;
};

// Calls paint(r, c) for each pixel of the sensor that the view shows, in the view's order.
template <typename Paint>
void for_each_pixel(const View& view, int rows, int cols, Paint paint) {
    const int row0 = view.crop.enabled ? view.crop.originY : 0;
    const int col0 = view.crop.enabled ? view.crop.originX : 0;
    for (int row = row0; row < row0 + rows; ++row) {
        for (int col = col0; col < col0 + cols; ++col) {
            paint(row, view.mirrored ? view.mode.resolutionX - 1 - col : col);
        }
    }
}

inline void paint_depth(const View& view, const RawImages& raw, uint16_t* out, int rows, int cols) {
    const int width = view.mode.resolutionX;
    const auto* image = reinterpret_cast<const uint16_t*>(
        raw.at(view.frame, size_t(width) * view.mode.resolutionY * sizeof(uint16_t)));
    const bool fine = view.mode.pixelFormat == ONI_PIXEL_FORMAT_DEPTH_100_UM;
    for_each_pixel(view, rows, cols, [&](int r, int c) {
        const uint16_t depth_mm = image ? image[r * width + c]
                                        : depth_at(view.frame, r, c + (view.registered ? kRegistrationShift : 0));
        // In steps of 0.1 mm the last digit tells the column, so that rounding shows.
        *out++ = static_cast<uint16_t>(fine ? depth_mm * 10 + c % 10 : depth_mm);
    });
}

inline void paint_color(const View& view, const RawImages& raw, uint8_t* out, int rows, int cols) {
    const int width = view.mode.resolutionX;
    const uint8_t* image = raw.at(view.frame, size_t(width) * view.mode.resolutionY * 3);
    for_each_pixel(view, rows, cols, [&](int r, int c) {
        uint8_t rgb[3];
        if (image) {
            std::copy_n(image + (size_t(r) * width + c) * 3, 3, rgb);
        } else {
            color_at(view.frame, r, c, rgb);
        }
        switch (view.mode.pixelFormat) {
            case ONI_PIXEL_FORMAT_GRAY8:
                *out++ = rgb[0];
                break;
            case ONI_PIXEL_FORMAT_YUV422:  // U Y V Y: gray, with the red channel as luminance
                *out++ = 128;
                *out++ = rgb[0];
                break;
            case ONI_PIXEL_FORMAT_YUYV:
                *out++ = rgb[0];
                *out++ = 128;
                break;
            default:
                out = std::copy_n(rgb, 3, out);
        }
    });
}

}  // namespace virtualcam
