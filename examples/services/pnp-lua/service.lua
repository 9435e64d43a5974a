-- pnp-lua: where a camera is, in the paper's own way (its Fig. 3): Lua decodes the JSON, a dynamic library
-- computes, Lua encodes the result.
local ffi = require "ffi"
local json = require "json"

ffi.cdef [[
int pnp_solve(const double *points_world, const double *pixels, int n, const double *camera, double *T_camera_world,
              double *rmse_px);
]]
local core = ffi.load(service_folder .. "/build/libcore.so")

local function bad(message)
  error({code = "bad-request", message = message})
end

local function rows(request, name, width)
  local values = request[name]
  if type(values) ~= "table" or #values % width ~= 0 then bad(name .. " must hold rows of " .. width) end
  return ffi.new("double[?]", math.max(#values, 1), values), #values / width
end

local function serve(text)
  local request = json.decode(text)
  local points, n = rows(request, "points_world", 3)
  local pixels, m = rows(request, "pixels", 2)
  if n ~= m or n < 6 or n > 5000 then bad("needs 6 to 5000 points, and as many pixels") end
  local c = request.camera
  if type(c) ~= "table" or not (c.fx and c.fy and c.cx and c.cy) then bad("camera needs fx, fy, cx and cy") end
  local T, rmse = ffi.new("double[16]"), ffi.new("double[1]")
  local inliers = core.pnp_solve(points, pixels, n, ffi.new("double[4]", c.fx, c.fy, c.cx, c.cy), T, rmse)
  if inliers < 6 then
    error({code = "degenerate", message = "no pose agrees with six matches"})
  end
  local reply = {T_camera_world = {}, inliers = inliers, rmse_px = rmse[0]}
  for i = 0, 15 do reply.T_camera_world[i + 1] = T[i] end
  return json.encode(reply)
end

return {serve = serve, takes_text = true}
