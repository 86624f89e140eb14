// An OpenNI2 driver for cameras that exist only as files NAME.cam in the folder $NURBSEG_VIRTUALCAM.
// A camera comes and goes with the line "plugged 1" or "plugged 0" of its file.
#include <dirent.h>

#include <atomic>
#include <list>

#include "stream.h"

namespace virtualcam {

// A camera's file, and the last script read from it.
struct Socket {
    std::string path;
    FileVersion version;
    ScriptPointer script;
    OniDeviceInfo info{};
    bool connected = false;
    std::atomic<bool> lost{false};
};

using SocketPointer = std::shared_ptr<Socket>;

class Device : public oni::driver::DeviceBase, public Camera {
public:
    explicit Device(SocketPointer socket) : socket_(std::move(socket)) {
        const auto script = this->script();
        for (auto format : {ONI_PIXEL_FORMAT_DEPTH_1_MM, ONI_PIXEL_FORMAT_DEPTH_100_UM}) {
            depth_modes_.push_back({format, 640, 480, 30});
            depth_modes_.push_back({format, 320, 240, 30});
            depth_modes_.push_back({format, 320, 240, 60});
        }
        const std::string formats = script->text("color_formats", "rgb888 yuv422");
        for (auto& known : {std::make_pair("rgb888", ONI_PIXEL_FORMAT_RGB888),
                            std::make_pair("yuv422", ONI_PIXEL_FORMAT_YUV422),
                            std::make_pair("yuyv", ONI_PIXEL_FORMAT_YUYV),
                            std::make_pair("gray8", ONI_PIXEL_FORMAT_GRAY8)}) {
            if (formats.find(known.first) == std::string::npos) continue;
            color_modes_.push_back({known.second, 640, 480, 30});
            color_modes_.push_back({known.second, 320, 240, 30});
            color_modes_.push_back({known.second, 320, 240, 60});
            color_modes_.push_back({known.second, 1280, 1024, 30});
        }
        sensors_[0] = {ONI_SENSOR_DEPTH, int(depth_modes_.size()), depth_modes_.data()};
        sensors_[1] = {ONI_SENSOR_COLOR, int(color_modes_.size()), color_modes_.data()};
    }

    OniStatus getSensorInfoList(OniSensorInfo** sensors, int* count) override {
        *sensors = sensors_;
        *count = script()->number("color", 1) ? 2 : 1;
        return ONI_STATUS_OK;
    }

    oni::driver::StreamBase* createStream(OniSensorType sensor) override {
        if (!present()) return nullptr;
        auto* stream = new Stream(*this, sensor, sensor == ONI_SENSOR_DEPTH ? depth_modes_ : color_modes_);
        streams_.push_back(stream);
        return stream;
    }

    void destroyStream(oni::driver::StreamBase* stream) override {
        streams_.remove(static_cast<Stream*>(stream));
        delete stream;
    }

    OniBool isPropertySupported(int property) override {
        if (property == ONI_DEVICE_PROPERTY_SERIAL_NUMBER) return !script()->text("serial", "VC0001").empty();
        if (property == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION) return registration() != "absent";
        return property == ONI_DEVICE_PROPERTY_DRIVER_VERSION || property == ONI_DEVICE_PROPERTY_HARDWARE_VERSION;
    }

    OniStatus getProperty(int property, void* data, int* size) override {
        if (property == ONI_DEVICE_PROPERTY_SERIAL_NUMBER) {
            const std::string serial = script()->text("serial", "VC0001");
            if (serial.empty()) return ONI_STATUS_NOT_SUPPORTED;
            if (*size <= int(serial.size())) return ONI_STATUS_BAD_PARAMETER;
            std::memcpy(data, serial.c_str(), serial.size() + 1);
            *size = int(serial.size()) + 1;
            return ONI_STATUS_OK;
        }
        if (property == ONI_DEVICE_PROPERTY_DRIVER_VERSION) return give(OniVersion{0, 1, 0, 0}, data, size);
        if (property == ONI_DEVICE_PROPERTY_HARDWARE_VERSION) return give(1, data, size);
        if (property == ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION && registration() != "absent")
            return give(registered_ ? ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR : ONI_IMAGE_REGISTRATION_OFF, data, size);
        return ONI_STATUS_NOT_SUPPORTED;
    }

    OniStatus setProperty(int property, const void* data, int size) override {
        if (property != ONI_DEVICE_PROPERTY_IMAGE_REGISTRATION || registration() == "absent")
            return ONI_STATUS_NOT_SUPPORTED;
        if (registration() == "refused") return ONI_STATUS_ERROR;
        OniImageRegistrationMode mode;
        if (take(mode, data, size) != ONI_STATUS_OK) return ONI_STATUS_BAD_PARAMETER;
        // Like some real cameras: asked too early, or scripted so, it says yes and does nothing.
        bool running = false;
        for (auto* stream : streams_) running = running || stream->running();
        if (running && registration() != "silent") registered_ = mode == ONI_IMAGE_REGISTRATION_DEPTH_TO_COLOR;
        return ONI_STATUS_OK;
    }

    OniBool isImageRegistrationModeSupported(OniImageRegistrationMode mode) override {
        return mode == ONI_IMAGE_REGISTRATION_OFF || registration() != "absent";
    }

    ScriptPointer script() const override { return std::atomic_load(&socket_->script); }
    bool present() const override { return !lost_ && !socket_->lost; }
    bool registered() const override { return registered_; }
    void lose() override { socket_->lost = true; }
    void mark_lost() { lost_ = true; }
    const SocketPointer& socket() const { return socket_; }

    Clock::time_point epoch() override {
        std::lock_guard<std::mutex> guard(lock_);
        bool running = false;
        for (auto* stream : streams_) running = running || stream->running();
        if (!running) epoch_ = Clock::now();
        return epoch_;
    }

private:
    std::string registration() const { return script()->text("registration", "on"); }

    SocketPointer socket_;
    std::vector<OniVideoMode> depth_modes_, color_modes_;
    OniSensorInfo sensors_[2]{};
    std::list<Stream*> streams_;
    std::mutex lock_;
    Clock::time_point epoch_;
    std::atomic<bool> registered_{false};
    std::atomic<bool> lost_{false};
};

class Driver : public oni::driver::DriverBase {
public:
    explicit Driver(OniDriverServices* services) : DriverBase(services) {}

    OniStatus initialize(oni::driver::DeviceConnectedCallback connected,
                         oni::driver::DeviceDisconnectedCallback disconnected,
                         oni::driver::DeviceStateChangedCallback changed, void* cookie) override {
        DriverBase::initialize(connected, disconnected, changed, cookie);
        const char* folder = std::getenv("NURBSEG_VIRTUALCAM");
        if (folder == nullptr) return ONI_STATUS_OK;
        folder_ = folder;
        look();
        watcher_ = std::thread([this] { watch(); });
        return ONI_STATUS_OK;
    }

    void shutdown() override {
        {
            std::lock_guard<std::mutex> guard(lock_);
            stopping_ = true;
        }
        wake_.notify_all();
        if (watcher_.joinable()) watcher_.join();
    }

    oni::driver::DeviceBase* deviceOpen(const char* uri, const char* /*mode*/) override {
        std::lock_guard<std::mutex> guard(lock_);
        for (const auto& socket : sockets_) {
            if (!socket->connected || std::strcmp(socket->info.uri, uri) != 0) continue;
            if (socket->script->number("busy", 0)) return nullptr;
            devices_.push_back(new Device(socket));
            return devices_.back();
        }
        return nullptr;
    }

    void deviceClose(oni::driver::DeviceBase* device) override {
        {
            std::lock_guard<std::mutex> guard(lock_);
            devices_.remove(static_cast<Device*>(device));
        }
        delete device;
    }

private:
    void watch() {
        for (;;) {
            {
                std::unique_lock<std::mutex> guard(lock_);
                if (wake_.wait_for(guard, std::chrono::milliseconds(2), [this] { return stopping_; })) return;
            }
            look();
        }
    }

    // Reads the files that changed, and reports who came and went. Reports are made without the lock,
    // because OpenNI2 may call back into the driver.
    void look() {
        std::vector<OniDeviceInfo> came, went;
        {
            std::lock_guard<std::mutex> guard(lock_);
            find_new();
            for (auto& socket : sockets_) {
                const FileVersion version = FileVersion::of(socket->path);
                if (version != socket->version) {
                    socket->version = version;
                    std::atomic_store(&socket->script, ScriptPointer(new Script(socket->path)));
                    socket->lost = false;
                }
                const bool plugged = version.exists() && socket->script->number("plugged", 1) && !socket->lost;
                if (plugged && !socket->connected) {
                    describe(*socket);
                    came.push_back(socket->info);
                } else if (!plugged && socket->connected) {
                    for (auto* device : devices_)
                        if (device->socket() == socket) device->mark_lost();
                    if (!socket->script->number("unplug_silently", 0)) went.push_back(socket->info);
                }
                socket->connected = plugged;
            }
        }
        for (const auto& info : went) deviceDisconnected(&info);
        for (const auto& info : came) deviceConnected(&info);
    }

    void find_new() {
        DIR* folder = opendir(folder_.c_str());
        if (folder == nullptr) return;
        while (const dirent* entry = readdir(folder)) {
            const std::string name = entry->d_name;
            if (name.size() < 5 || name.compare(name.size() - 4, 4, ".cam") != 0) continue;
            const std::string path = folder_ + "/" + name;
            bool known = false;
            for (const auto& socket : sockets_) known = known || socket->path == path;
            if (known) continue;
            auto socket = std::make_shared<Socket>();
            socket->path = path;
            socket->script = ScriptPointer(new Script(path));
            socket->version = FileVersion::of(path);
            sockets_.push_back(socket);
        }
        closedir(folder);
    }

    static void describe(Socket& socket) {
        const Script& script = *socket.script;
        const std::string file = socket.path.substr(socket.path.rfind('/') + 1);
        const std::string stem = file.substr(0, file.size() - 4);
        std::snprintf(socket.info.uri, sizeof socket.info.uri, "%s", script.text("uri", "virtual/" + stem).c_str());
        std::snprintf(socket.info.vendor, sizeof socket.info.vendor, "%s", script.text("vendor", "PrimeSense").c_str());
        std::snprintf(socket.info.name, sizeof socket.info.name, "%s", script.text("name", "PS1080").c_str());
        socket.info.usbVendorId = uint16_t(script.number("usb_vendor", 0x1d27));
        socket.info.usbProductId = uint16_t(script.number("usb_product", 0x0601));
    }

    std::string folder_;
    std::mutex lock_;
    std::condition_variable wake_;
    std::thread watcher_;
    bool stopping_ = false;
    std::list<SocketPointer> sockets_;
    std::list<Device*> devices_;

public:
    void* enableFrameSync(oni::driver::StreamBase** streams, int count) override {
        // Frames are numbered alike in both streams, which is all that OpenNI2 needs to match them.
        std::lock_guard<std::mutex> guard(lock_);
        for (auto* device : devices_)
            if (count > 0 && !device->script()->number("sync", 1)) return nullptr;
        return streams;
    }
    void disableFrameSync(void* /*group*/) override {}
};

}  // namespace virtualcam

using virtualcam::Driver;
ONI_EXPORT_DRIVER(Driver)
