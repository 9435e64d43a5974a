-- icp-lua: align one cloud of points to another, in the paper's own way (its Fig. 3): Lua decodes the JSON,
-- a dynamic library computes, Lua encodes the result.
local ffi = require "ffi"
local json = require "json"

ffi.cdef [[
double icp_align(const double *source, int n, const double *target, int m, int iterations, double *T_target_source);
]]
local core = ffi.load(service_folder .. "/build/libcore.so")

local function cloud(request, name)
  local points = request[name]
  if type(points) ~= "table" or #points % 3 ~= 0 or #points < 9 or #points > 6000 then
    error({code = "bad-request", message = name .. " must hold 3 to 2000 rows of 3 numbers"})
  end
  return ffi.new("double[?]", #points, points), #points / 3
end

local function serve(text)
  local request = json.decode(text)
  local source, n = cloud(request, "source")
  local target, m = cloud(request, "target")
  local T = ffi.new("double[16]")
  local rmse = core.icp_align(source, n, target, m, request.iterations or 30, T)
  local reply = {T_target_source = {}, rmse_m = rmse}
  for i = 0, 15 do reply.T_target_source[i + 1] = T[i] end
  return json.encode(reply)
end

return {serve = serve, takes_text = true}
