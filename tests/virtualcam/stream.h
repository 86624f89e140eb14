// One stream of a virtual camera: its properties, and the thread that delivers its frames on time.
#pragma once

#include <fcntl.h>
#include <unistd.h>

#include <chrono>
#include <cmath>
#include <condition_variable>
#include <cstdio>
#include <cstring>
#include <mutex>
#include <thread>

#define XN_NEW(type, ...) new type(__VA_ARGS__)
#define XN_DELETE(pointer) delete (pointer)
#include "Driver/OniDriverAPI.h"

#include "pixels.h"
#include "script.h"

namespace virtualcam {

using Clock = std::chrono::steady_clock;

// What the streams of one opened camera share.
class Camera {
public:
    virtual ~Camera() = default;
    virtual ScriptPointer script() const = 0;
    virtual bool present() const = 0;
    virtual bool registered() const = 0;
    virtual Clock::time_point epoch() = 0;
    virtual void lose() = 0;
};

inline int bytes_per_pixel(OniPixelFormat format) {
    if (format == ONI_PIXEL_FORMAT_RGB888) return 3;
    return format == ONI_PIXEL_FORMAT_GRAY8 ? 1 : 2;
}

template <typename T>
OniStatus give(const T& value, void* data, int* size) {
    if (*size < int(sizeof(T))) return ONI_STATUS_BAD_PARAMETER;
    std::memcpy(data, &value, sizeof(T));
    *size = sizeof(T);
    return ONI_STATUS_OK;
}

template <typename T>
OniStatus take(T& value, const void* data, int size) {
    if (size != int(sizeof(T))) return ONI_STATUS_BAD_PARAMETER;
    std::memcpy(&value, data, sizeof(T));
    return ONI_STATUS_OK;
}

class Stream : public oni::driver::StreamBase {
public:
    Stream(Camera& camera, OniSensorType sensor, const std::vector<OniVideoMode>& modes)
        : camera_(camera), sensor_(sensor), modes_(modes), mode_(modes.front()) {
        if (camera.script()->number("cropped", 0)) crop_ = OniCropping{TRUE, 10, 20, 100, 50};
        raw_.load(camera.script()->text("frames"), depth() ? "depth" : "color");
    }
    ~Stream() override { stop(); }

    OniStatus start() override {
        if (!camera_.present()) return ONI_STATUS_ERROR;
        const auto epoch = camera_.epoch();
        std::lock_guard<std::mutex> guard(lock_);
        if (thread_.joinable()) return ONI_STATUS_OK;
        stopping_ = false;
        epoch_ = epoch;
        thread_ = std::thread([this] { deliver(); });
        return ONI_STATUS_OK;
    }

    void stop() override {
        std::thread finished;
        {
            std::lock_guard<std::mutex> guard(lock_);
            stopping_ = true;
            finished.swap(thread_);
        }
        wake_.notify_all();
        if (finished.joinable()) finished.join();
    }

    bool running() {
        std::lock_guard<std::mutex> guard(lock_);
        return thread_.joinable();
    }

    OniBool isPropertySupported(int property) override {
        if (property >= ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE && property <= ONI_STREAM_PROPERTY_GAIN)
            return !depth() && camera_.script()->number("controls", 1);
        if (property == ONI_STREAM_PROPERTY_MIRRORING) return camera_.script()->text("mirror") != "absent";
        return property >= ONI_STREAM_PROPERTY_CROPPING && property <= ONI_STREAM_PROPERTY_MIRRORING;
    }

    OniStatus getProperty(int property, void* data, int* size) override {
        if (!isPropertySupported(property)) return ONI_STATUS_NOT_SUPPORTED;
        std::lock_guard<std::mutex> guard(lock_);
        switch (property) {
            case ONI_STREAM_PROPERTY_CROPPING: return give(crop_, data, size);
            case ONI_STREAM_PROPERTY_HORIZONTAL_FOV: return give(field_of_view("fov_horizontal", 1.0226), data, size);
            case ONI_STREAM_PROPERTY_VERTICAL_FOV: return give(field_of_view("fov_vertical", 0.79661), data, size);
            case ONI_STREAM_PROPERTY_VIDEO_MODE: return give(mode_, data, size);
            case ONI_STREAM_PROPERTY_MAX_VALUE: return give(int(depth() ? camera_.script()->number("max_value", 50000) : 255), data, size);
            case ONI_STREAM_PROPERTY_MIN_VALUE: return give(0, data, size);
            case ONI_STREAM_PROPERTY_STRIDE: return give(mode_.resolutionX * bytes_per_pixel(mode_.pixelFormat), data, size);
            case ONI_STREAM_PROPERTY_MIRRORING: return give(mirrored_, data, size);
            case ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE: return give(auto_white_balance_, data, size);
            case ONI_STREAM_PROPERTY_AUTO_EXPOSURE: return give(auto_exposure_, data, size);
            case ONI_STREAM_PROPERTY_EXPOSURE: return give(exposure_, data, size);
            case ONI_STREAM_PROPERTY_GAIN: return give(gain_, data, size);
        }
        return ONI_STATUS_NOT_SUPPORTED;
    }

    OniStatus setProperty(int property, const void* data, int size) override {
        if (!isPropertySupported(property)) return ONI_STATUS_NOT_SUPPORTED;
        std::lock_guard<std::mutex> guard(lock_);
        switch (property) {
            case ONI_STREAM_PROPERTY_CROPPING: return take(crop_, data, size);
            case ONI_STREAM_PROPERTY_VIDEO_MODE: return set_mode(data, size);
            case ONI_STREAM_PROPERTY_MIRRORING:
                return camera_.script()->text("mirror") == "stuck" ? ONI_STATUS_OK : take(mirrored_, data, size);
            case ONI_STREAM_PROPERTY_AUTO_WHITE_BALANCE: return take(auto_white_balance_, data, size);
            case ONI_STREAM_PROPERTY_AUTO_EXPOSURE: return take(auto_exposure_, data, size);
            case ONI_STREAM_PROPERTY_EXPOSURE: return take(exposure_, data, size);
            case ONI_STREAM_PROPERTY_GAIN: return take(gain_, data, size);
        }
        return ONI_STATUS_NOT_SUPPORTED;
    }

    // A recorder learns the state of the stream from these notices.
    void notifyAllProperties() override {
        for (int property : {ONI_STREAM_PROPERTY_VIDEO_MODE, ONI_STREAM_PROPERTY_HORIZONTAL_FOV,
                             ONI_STREAM_PROPERTY_VERTICAL_FOV, ONI_STREAM_PROPERTY_MAX_VALUE,
                             ONI_STREAM_PROPERTY_MIRRORING, ONI_STREAM_PROPERTY_CROPPING}) {
            char value[64];
            int size = sizeof value;
            if (getProperty(property, value, &size) == ONI_STATUS_OK) raisePropertyChanged(property, value, size);
        }
    }

private:
    bool depth() const { return sensor_ == ONI_SENSOR_DEPTH; }

    float field_of_view(const char* key, double nominal) const { return float(camera_.script()->real(key, nominal)); }

    OniStatus set_mode(const void* data, int size) {
        OniVideoMode wanted;
        if (take(wanted, data, size) != ONI_STATUS_OK) return ONI_STATUS_BAD_PARAMETER;
        char name[32];
        std::snprintf(name, sizeof name, "%dx%d@%d", wanted.resolutionX, wanted.resolutionY, wanted.fps);
        if (camera_.script()->text(depth() ? "refuse_depth_mode" : "refuse_color_mode") == name)
            return ONI_STATUS_NOT_SUPPORTED;
        for (const auto& mode : modes_) {
            if (std::memcmp(&mode, &wanted, sizeof mode) == 0) {
                mode_ = wanted;
                return ONI_STATUS_OK;
            }
        }
        return ONI_STATUS_BAD_PARAMETER;
    }

    void deliver() {
        const auto period = std::chrono::nanoseconds(1000000000LL / mode_.fps);
        for (long frame = 0;; ++frame) {
            const ScriptPointer script = camera_.script();
            // A sequence that scatters, but is the same each time.
            const long jitter_us = script->number("jitter_us", 0);
            const long jitter = jitter_us ? long((uint64_t(frame) * 2654435761u >> 7) % uint64_t(jitter_us)) : 0;
            {
                std::unique_lock<std::mutex> guard(lock_);
                // The camera's own clock, which a busy computer may need to be slower than others.
                const auto due = epoch_ + script->number("slowdown", 1) *
                                              ((frame + 1) * period + std::chrono::microseconds(jitter));
                wake_.wait_until(guard, due, [this] { return stopping_; });
                if (stopping_) return;
            }
            if (script->number("unplug_at", -1) == frame) camera_.lose();
            if (!camera_.present()) continue;
            if (script->number("stalled", 0) || script->lists("stall", frame)) continue;
            if (script->lists(depth() ? "drop_depth" : "drop_color", frame)) continue;
            long stamp_us = frame * 1000000L / mode_.fps + jitter;
            if (!depth()) stamp_us += script->number("color_delay_us", 0);
            const long jump_at = script->number("time_jump_at", -1);
            if (jump_at >= 0 && frame >= jump_at) stamp_us += script->number("time_jump_us", 0);
            if (depth()) note(script->text("diary"), frame);
            emit(frame, stamp_us);
        }
    }

    // Adds a line to a file, by the time another process sees it: which image comes, and when.
    static void note(const std::string& path, long frame) {
        if (path.empty()) return;
        const int file = open(path.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600);
        if (file < 0) return;
        char line[64];
        const long long now_ns = std::chrono::duration_cast<std::chrono::nanoseconds>(
            Clock::now().time_since_epoch()).count();
        const int size = std::snprintf(line, sizeof line, "%ld %lld\n", frame, now_ns);
        if (write(file, line, size) != size) std::perror("virtual camera: diary");
        close(file);
    }

    void emit(long number, long stamp_us) {
        OniFrame* frame = getServices().acquireFrame();
        if (frame == nullptr) return;
        View view{};
        {
            std::lock_guard<std::mutex> guard(lock_);
            view = View{mode_, crop_, mirrored_ != 0, depth() && camera_.registered(), number};
        }
        const int width = view.crop.enabled ? view.crop.width : view.mode.resolutionX;
        const int height = view.crop.enabled ? view.crop.height : view.mode.resolutionY;
        frame->sensorType = sensor_;
        frame->timestamp = uint64_t(stamp_us);
        frame->frameIndex = int(number) + 1;
        frame->videoMode = view.mode;
        frame->width = width;
        frame->height = height;
        frame->croppingEnabled = view.crop.enabled;
        frame->cropOriginX = view.crop.enabled ? view.crop.originX : 0;
        frame->cropOriginY = view.crop.enabled ? view.crop.originY : 0;
        frame->stride = width * bytes_per_pixel(view.mode.pixelFormat);
        frame->dataSize = frame->stride * height;
        if (depth()) {
            paint_depth(view, raw_, static_cast<uint16_t*>(frame->data), height, width);
        } else {
            paint_color(view, raw_, static_cast<uint8_t*>(frame->data), height, width);
        }
        const ScriptPointer script = camera_.script();
        if (script->lists(depth() ? "short_depth" : "short_color", number)) frame->dataSize /= 2;
        if (script->lists(depth() ? "low_depth" : "low_color", number)) frame->height /= 2;
        raiseNewFrame(frame);
        getServices().releaseFrame(frame);
    }

    Camera& camera_;
    const OniSensorType sensor_;
    const std::vector<OniVideoMode> modes_;
    RawImages raw_;
    std::mutex lock_;
    std::condition_variable wake_;
    std::thread thread_;
    bool stopping_ = false;
    Clock::time_point epoch_;
    OniVideoMode mode_;
    OniCropping crop_{};
    OniBool mirrored_ = TRUE;  // as the real cameras start
    OniBool auto_white_balance_ = TRUE;
    OniBool auto_exposure_ = TRUE;
    int exposure_ = 100;
    int gain_ = 100;
};

}  // namespace virtualcam
